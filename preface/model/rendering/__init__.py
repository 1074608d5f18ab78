"""Images of a model: `image` renders what a camera sees, `paths` says where cameras go, `mesh` finds the surface."""
