import io

import numpy as np
from PIL import Image

from geomocap.angles.angle_set import AngleSet
from viz.angle_plots import angle_sheet


def test_a_wider_band_covers_more_of_the_picture():
    t = np.linspace(0, 6, 40)
    values = np.stack([20 * np.sin(t), 20 * np.cos(t), t], axis=1)
    names = ("knee_left_flexion", "knee_right_flexion", "wrist_off_axis")
    pictures = []
    for std in (np.nan, 5.0):
        angles = AngleSet(names, values, np.full(values.shape, std), 30.0, np.zeros((len(names), 2), int))
        png = angle_sheet(angles)
        pictures.append(np.asarray(Image.open(io.BytesIO(png)).convert("L"), float))
    dark = [(p < 250).mean() for p in pictures]
    assert dark[1] > dark[0] + 0.02
