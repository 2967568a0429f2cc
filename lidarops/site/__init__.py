"""A static browser of the products of a campaign: pages that need no server and no network."""
