"""How exactly models predict next states they have not seen, after how many steps of random play."""
