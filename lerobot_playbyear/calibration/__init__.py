"""How much later sound arrives than pictures: measured from taps that a camera sees and a microphone hears."""
