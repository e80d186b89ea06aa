"""What has nothing to do with motion: files that people write, secrets, log lines, tasks, memory."""
