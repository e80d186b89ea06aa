"""Speed, latency and accuracy, measured side by side with peers: ``python -m benchmarks <suite>``."""

import gateway as gateway  # before NumPy: settles which instructions it takes
