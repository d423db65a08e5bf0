"""What runs the commands; a module is named as that of their options."""
