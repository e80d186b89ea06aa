"""A recording as one page: what was lost, how the clocks fared, what was made of it.

``gathering`` goes through the file once; ``plots`` draws; ``page`` puts all into one HTML file.
"""

from gateway.report.gathering import Findings, gather
from gateway.report.page import write_report

__all__ = ["Findings", "gather", "write_report"]
