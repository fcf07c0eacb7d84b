"""Strict JSON, arrays, atomic writes, and the one error that means bad input; knows no grid."""
