"""The workbench: a page on which an engineer compares, sees where the model fails, adds what it lacks, and goes on."""
