"""Does a module keep the rules of the wire protocol? For makers of firmware: a link to it is enough.

Reading order: ``bench`` (the module, and all that it said) → ``rule`` (what a rule is) → ``streaming``,
``timing``, ``commanding``, ``writing`` (the rules) → ``run`` (all of them in order). A new rule is a check
under ``@rule`` in the file of its family, and in the tuple at that file's end.
"""

from devices.conformance.rule import Rule, RuleOutcome, RuleResult
from devices.conformance.run import RULES, check_module

__all__ = ["RULES", "Rule", "RuleOutcome", "RuleResult", "check_module"]
