"""Strict JSON, arrays, typed CSV, paths, atomic writes, and the error that means bad input; knows no grid."""
