"""Benchmarks: speed and accuracy of nerif, and of other programs on the same data (README.md)."""
