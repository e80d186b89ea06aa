"""Synchronised cameras to skeleton frames, without markers."""
