"""One event loop around the pipeline: links before it, outputs after, and what watches over both.

Reading order: ``service``, ``observability``, ``accounting``, ``overload``; then the others, each alone.
"""
