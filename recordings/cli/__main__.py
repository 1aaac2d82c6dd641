from recordings.cli import main

main()
