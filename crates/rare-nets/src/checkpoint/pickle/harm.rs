//! What Python would do damage with. Nothing is ever called here; a file that wants these called is refused all the same,
//! because its other readers would obey.

/// Modules that start programs, reach files or the network, or run what they are given.
const MODULES: [&str; 17] = [
    "asyncio",
    "bdb",
    "builtins",
    "__builtin__",
    "ctypes",
    "importlib",
    "marshal",
    "nt",
    "os",
    "pdb",
    "posix",
    "pty",
    "runpy",
    "shutil",
    "socket",
    "subprocess",
    "webbrowser",
];

/// What of the built-in functions is data.
const DATA: [&str; 14] = [
    "bool",
    "bytearray",
    "bytes",
    "complex",
    "dict",
    "float",
    "frozenset",
    "getattr",
    "int",
    "list",
    "object",
    "set",
    "slice",
    "tuple",
];

/// Whether the class or function of this full name is known to run code. Any part of the name counts: `a.os.system` is
/// `os.system` if the module `a` has imported `os`.
pub(super) fn runs_code(name: &str) -> bool {
    match name.strip_prefix("builtins.").or_else(|| name.strip_prefix("__builtin__.")) {
        Some(function) => !DATA.contains(&function),
        None => name.split('.').any(|part| MODULES.contains(&part)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_runs_code_is_told_from_what_is_data() {
        for name in ["os.system", "posix.system", "torch.serialization.os.system", "builtins.eval"]
        {
            assert!(runs_code(name), "{name}");
        }
        for name in ["builtins.set", "__builtin__.object", "easydict.EasyDict", "code.Config"] {
            assert!(!runs_code(name), "{name}");
        }
    }
}
