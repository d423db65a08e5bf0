"""Which frames of a capture to keep: those whose removal the surfaces would not miss."""
