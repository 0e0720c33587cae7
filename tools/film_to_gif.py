"""Makes a small moving picture: `python tools/film_to_gif.py outputs/demo/rollout.mp4 docs/media/rollout.gif`."""

import sys

import av
from PIL import Image

_WIDTH, _EVERY, _COLOURS = 300, 2, 96


def main(film: str, picture: str) -> None:
    """Every second frame, 300 pixels wide, few colours."""
    with av.open(film) as container:
        rate = float(container.streams.video[0].average_rate or 20)
        frames = [frame.to_image() for i, frame in enumerate(container.decode(video=0)) if i % _EVERY == 0]
    height = round(_WIDTH * frames[0].height / frames[0].width)
    small = [frame.resize((_WIDTH, height)).quantize(_COLOURS, Image.Quantize.FASTOCTREE) for frame in frames]
    small[0].save(
        picture, save_all=True, append_images=small[1:], duration=round(1000 * _EVERY / rate), loop=0, optimize=True
    )


if __name__ == "__main__":
    main(*sys.argv[1:3])
