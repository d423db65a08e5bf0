"""What procedural things are made of: textures, and the finishes made with them."""
