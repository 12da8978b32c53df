"""Sealant: pneumatics, the bead on the part, smoothing. Arrays in, arrays out."""
