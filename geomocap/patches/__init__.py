"""Surface patches followed in the images of all cameras that see them."""
