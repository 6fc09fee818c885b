"""Windows: `import fcntl` at module level stops every command, even `velap info`.

pollen-robotics/reachy_mini#298, modelscope/ms-swift#1350
"""

import sys

from case import HERE, run, verdict

(HERE / "win.py").write_text("""import sys
sys.modules["fcntl"] = None
from velap.cli import main
sys.exit(main(sys.argv[1:]))
""")
code, text = run("info", command=[sys.executable, "win.py"])
verdict("Traceback" not in text, "it works without fcntl")
