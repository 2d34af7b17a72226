"""Measurements: each command prints ratios within one run, since machines are noisy."""
