"""Emulated suits as the gateway sees them: known truth for the demo, for tests and for benchmarks.

The emulators know nothing of the gateway. What joins the two stands here: rigs as bodies that move, their
samples as frames, the poses that are true, and recordings with a reference played through the pipeline.
"""
