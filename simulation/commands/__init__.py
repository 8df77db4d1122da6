"""Commands of the simulation: `surecut campaign` and others."""
