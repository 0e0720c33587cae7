"""Makes a small moving picture of films, side by side: `python tools/film_to_gif.py one.mp4 two.mp4 beside.gif`."""

import sys

import av
from PIL import Image

_WIDTH, _EVERY, _COLOURS = 260, 3, 64


def frames_of(film: str) -> tuple[list[Image.Image], float]:
    """Every third frame, small, and the film's frames per second."""
    with av.open(film) as container:
        rate = float(container.streams.video[0].average_rate or 20)
        frames = [frame.to_image() for i, frame in enumerate(container.decode(video=0)) if i % _EVERY == 0]
    height = round(_WIDTH * frames[0].height / frames[0].width)
    return [frame.resize((_WIDTH, height)) for frame in frames], rate


def main(films: list[str], picture: str) -> None:
    """A film that ends before the others keeps its last frame."""
    read = [frames_of(film) for film in films]
    rows = []
    for i in range(max(len(frames) for frames, _ in read)):
        row = Image.new("RGB", (_WIDTH * len(read), read[0][0][0].height))
        for n, (frames, _) in enumerate(read):
            row.paste(frames[min(i, len(frames) - 1)], (_WIDTH * n, 0))
        rows.append(row.quantize(_COLOURS, Image.Quantize.FASTOCTREE))
    duration = round(1000 * _EVERY / read[0][1])
    rows[0].save(picture, save_all=True, append_images=rows[1:], duration=duration, loop=0, optimize=True)


if __name__ == "__main__":
    main(sys.argv[1:-1], sys.argv[-1])
