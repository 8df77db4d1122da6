"""The commands that rest on the estimator."""
