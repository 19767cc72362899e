"""Files: one module for each format family; nothing else in the package reads or writes them."""
