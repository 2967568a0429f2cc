"""Small campaigns, archives of raw files and of products, and runs over them."""
