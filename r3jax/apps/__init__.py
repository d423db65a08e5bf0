"""What is built on the flow, each by itself: audit, benchmark, viewer."""
