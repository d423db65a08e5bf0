"""What the pages of experiments are made of: records of origin, tables, figures."""
