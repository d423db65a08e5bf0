"""3D Gaussian splatting: render, train, store."""
