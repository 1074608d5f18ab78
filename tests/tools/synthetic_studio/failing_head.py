"""People of whom the second cannot be rendered from the sides."""

import numpy as np
import sphere_head


class Subject(sphere_head.Subject):
    def render(self, camera, camera_from_studio, antialias):
        turned = np.degrees(np.arccos(-camera_from_studio.rotation[2, 2]))
        if self.index == 1 and turned > 30:
            raise ArithmeticError("no light on this side")
        return super().render(camera, camera_from_studio, antialias)
