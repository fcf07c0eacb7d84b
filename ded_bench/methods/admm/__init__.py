"""A learned dispatch policy whose weights are shared by all generators and knots."""
