"""How pages and figures look: style, plots, pictures."""
