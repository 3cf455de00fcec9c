"""Calibration as a scikit-learn estimator."""

from cfx_sklearn.regressor import CarFollowingRegressor

__all__ = ["CarFollowingRegressor"]
