"""Files that anybody may have written: what is checked before any reader believes them."""
