"""Observations of one kind put together by instant, and solved: modules, markers, cameras."""
