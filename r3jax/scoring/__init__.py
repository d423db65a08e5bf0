"""How well a view could be rendered, and what it would add: the closed forms."""
