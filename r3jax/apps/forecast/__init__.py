"""How well models of the views collected so far would come out, from the map alone."""
