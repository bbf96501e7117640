"""Pages, figures, Rerun recordings and prose of what a comparison and a diagnosis found."""
