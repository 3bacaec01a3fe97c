"""Whether a file of starts has every pair of a list: `covers.py PAIRS.json STARTS.json` exits with 0 or 1."""
import json
import sys

pairs, starts = (json.load(open(path)) for path in sys.argv[1:])
have = {(pair["src"], pair["ref"]) for pair in starts["pairs"]}
sys.exit(not all((pair["src"], pair["ref"]) in have for pair in pairs))
