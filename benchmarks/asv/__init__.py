"""Benchmarks for asv: ``docs/dev/benchmarks.md``."""
