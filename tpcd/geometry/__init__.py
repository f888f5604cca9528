"""What an object can touch: tables of surfaces, the contact query, the search for candidates."""
