"""Inverse kinematics and motions to a goal. Arrays in, arrays out; knows nothing of MuJoCo or Gymnasium."""
