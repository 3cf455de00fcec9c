"""SUMO as a simulator, in processes of its own.

Importing this package imports neither torch nor SUMO: the SUMO processes start from here.
"""
