"""Policies: the RMP expert, learned policies and their training."""
