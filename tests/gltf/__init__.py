"""What the tests of GLB files use: a reader of their own, and other people's programs."""
