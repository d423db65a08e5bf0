"""Planning: candidates, paths through known free space, policies."""
