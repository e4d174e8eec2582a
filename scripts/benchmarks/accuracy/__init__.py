"""gnrecon and its peers on scans of known surfaces."""
