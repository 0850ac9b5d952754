"""What people read: the report and comparisons."""
