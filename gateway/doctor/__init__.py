"""What stands between a configuration and a running suit: findings, each with its remedy.

Reading order: ``findings``, ``examination`` (what is looked at, in which order), then
``links``, ``broker`` and ``running``.
"""
