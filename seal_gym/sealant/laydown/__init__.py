"""Reference simulation of sealant laydown: a jet of yield-stress fluid on a substrate, solved by OpenFOAM."""
