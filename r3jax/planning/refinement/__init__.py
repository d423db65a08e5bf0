"""The best candidates climb the slope of the utility."""
