//! What Python would do damage with. Nothing is ever called here; a file that wants these called is refused all the same,
//! because its other readers would obey.

/// Modules that start programs, reach files or the network, or run what they are given.
const MODULES: [&str; 24] = [
    "asyncio",
    "bdb",
    "code",
    "codeop",
    "commands",
    "ctypes",
    "http",
    "importlib",
    "marshal",
    "multiprocessing",
    "nt",
    "os",
    "pdb",
    "pickle",
    "posix",
    "pty",
    "requests",
    "runpy",
    "shutil",
    "socket",
    "subprocess",
    "sys",
    "urllib",
    "webbrowser",
];

/// Built-in functions that run what they are given, or reach everything else.
const FUNCTIONS: [&str; 10] = [
    "__import__",
    "apply",
    "breakpoint",
    "compile",
    "delattr",
    "eval",
    "exec",
    "execfile",
    "open",
    "setattr",
];

/// Whether the class or function of this full name runs code.
pub(super) fn runs_code(name: &str) -> bool {
    let (module, rest) = name.split_once('.').unwrap_or((name, ""));
    match module {
        "builtins" | "__builtin__" => FUNCTIONS.contains(&rest),
        module => MODULES.contains(&module),
    }
}
