"""Errors, checked numbers and arrays, YAML, atomic files, compiled functions."""
