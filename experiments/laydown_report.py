"""Tables and pictures of the laydown reference."""
