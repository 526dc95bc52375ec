"""Parts of benchmarks/learning.py: data sets, methods, results on disk, the page."""
