"""The sealing task: progress, outcome, metrics and reward, as pure functions of arrays."""
