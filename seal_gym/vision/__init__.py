"""Pixels and projections to ROI features. Arrays in, arrays out; knows nothing of MuJoCo or Gymnasium."""
