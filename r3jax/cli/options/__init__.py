"""The options of every command. Light on purpose: `--help` must not wait for JAX."""
