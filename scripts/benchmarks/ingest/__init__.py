"""What it costs to read large scans."""
