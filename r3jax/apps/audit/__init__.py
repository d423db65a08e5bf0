"""What a capture that exists lacks for splats, and which views would mend it."""
