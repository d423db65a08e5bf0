"""Lines, floods and shortest paths over the cells of a grid."""
