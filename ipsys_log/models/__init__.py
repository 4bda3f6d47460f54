"""Models: scikit-learn estimators that map camera points to world points."""
