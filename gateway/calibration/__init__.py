"""What has to be measured before a capture: sensors, and how modules sit on their segments."""
