"""Sound beside pictures: samples and their number as pixels, and the sound of each control step."""
