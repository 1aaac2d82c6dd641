"""Messages of a recording (`messages`), its topics, and what it shows viewers like Foxglove (`viewing`)."""
