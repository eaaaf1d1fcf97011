"""What built-in colours share."""
