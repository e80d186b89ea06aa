"""Speed, latency and accuracy, measured side by side with peers: ``python -m benchmarks <suite>``."""
