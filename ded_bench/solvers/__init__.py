"""The one place that calls a solver: IPOPT, HiGHS, PIQP."""
