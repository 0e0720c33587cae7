"""Datasets and policies on the Hugging Face Hub: uploads that go on where they ended, and cards that say what is heard."""
