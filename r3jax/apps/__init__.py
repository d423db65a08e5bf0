"""Applications built on the flow, independent of each other: audit, benchmark, viewer."""
