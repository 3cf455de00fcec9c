"""Objectives: what calibration minimises and what closed-loop training back-propagates."""
