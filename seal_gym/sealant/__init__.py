"""Sealant: pneumatics, deposition on the part, laydown reference, cross-sections. Arrays in, arrays out."""
