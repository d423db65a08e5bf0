"""Several cameras that explore one place and exchange frames."""
