"""Inverse kinematics. Arrays in, arrays out; knows nothing of MuJoCo or Gymnasium."""
