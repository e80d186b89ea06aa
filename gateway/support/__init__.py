"""What has nothing to do with motion. Each file is one idea, read by itself.

- Files: ``settings_files`` (YAML that people write, checked, errors with line and remedy) on ``yaml_text``;
  ``whole_files`` (written whole or not at all), ``file_lock``.
- Names and words: ``names`` (what may come from outside), ``former_names``, ``extras`` (packages that are
  not always installed).
- Guarding: ``credentials``, ``crowd`` (bounds on who connects).
- The process: ``log_format``, ``supervision`` (tasks that must not end unnoticed), ``memory``,
  ``processor``.
- ``rows``: numbers with names in memory that Python and kernels share.
"""
