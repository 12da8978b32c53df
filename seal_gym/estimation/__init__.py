"""Estimators over time. Arrays in, arrays out; knows nothing of MuJoCo or Gymnasium."""
