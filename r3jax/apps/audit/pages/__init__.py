"""The report of an audit: its page, figures, map from above, words and colors."""
