"""What `cfx plugins` shows, checks and writes."""
