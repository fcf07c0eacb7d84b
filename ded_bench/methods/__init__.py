"""Dispatch methods, one module or folder each; `registry` names them all."""
