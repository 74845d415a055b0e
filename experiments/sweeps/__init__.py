"""Many runs: variants, the programs that train them together, and who carries those out."""
