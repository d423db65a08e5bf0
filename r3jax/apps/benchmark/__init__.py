"""The benchmark: scenes x policies x seeds on equal terms, each cell done once and recorded."""
