"""The surrogate: a linear model of (ω, P_s), its physics, its data and its identification."""
