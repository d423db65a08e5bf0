"""The page in the browser: what it shows, what the user asks of it, and its server."""
