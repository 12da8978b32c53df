"""Chooses MuJoCo's OpenGL backend; import this before anything that imports mujoco."""

from agents.backend import choose

__all__ = ["choose"]
