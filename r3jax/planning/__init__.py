"""Where to go: candidates, travel over known free space, policies."""
