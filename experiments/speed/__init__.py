"""How fast training is, compared with the physics engine alone and with other packages."""
