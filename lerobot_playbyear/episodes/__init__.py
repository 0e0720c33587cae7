"""Episodes: whoever acts in an environment, and what happens then."""
