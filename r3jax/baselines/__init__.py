"""Re-implemented policies of other papers, with and without a radiance field."""
