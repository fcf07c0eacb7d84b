"""Strict JSON, arrays, typed CSV, atomic writes, paths, and the one error that means bad input; knows no grid."""
