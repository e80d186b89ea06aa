"""What stands between a configuration and a running suit: findings, each with its remedy.

Reading order: ``findings``, ``examination`` (what is looked at, in which order), then
``links``, ``broker`` and ``running``.
"""

from gateway.doctor.examination import examine, examine_file
from gateway.doctor.findings import Finding, Surroundings, Verdict
from gateway.doctor.links import capacity

__all__ = ["Finding", "Surroundings", "Verdict", "capacity", "examine", "examine_file"]
