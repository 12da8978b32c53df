"""Seam curves, and the parts that carry them."""
