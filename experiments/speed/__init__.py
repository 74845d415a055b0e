"""How fast the program is, beside the engine alone and beside other libraries."""
