//! Where the hub is, who asks, and what it has left on this machine: the environment variables that the hub's own
//! programs obey.

use std::ffi::OsString;
use std::fmt;
use std::fs;
use std::path::{Path, PathBuf};
use std::time::Duration;

use rare::{Error, Result};

use super::Choice;

const ENDPOINT: &str = "https://huggingface.co";
/// How long to wait before the second attempt; twice as long before each further one.
const PAUSE: Duration = Duration::from_secs(1);

/// Where weights come from.
#[derive(Debug, Clone)]
pub struct Hub {
    /// The server, without a slash at the end.
    pub endpoint: String,
    /// Who asks, where a repository is not open to everybody.
    pub token: Option<Token>,
    /// The folder of the hub's files that other programs have downloaded on this machine.
    pub cache: PathBuf,
    /// Whether to use these alone and no network.
    pub offline: bool,
    /// How long to wait before the second attempt on a broken connection; twice as long before each further one.
    pub pause: Duration,
}

/// A secret; it is never printed.
#[derive(Clone, PartialEq, Eq)]
pub struct Token(String);

impl fmt::Debug for Token {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str("Token(..)")
    }
}

impl Token {
    /// Takes a token; `None` if there is nothing but white space.
    #[must_use]
    pub fn new(text: &str) -> Option<Token> {
        let text = text.trim();
        (!text.is_empty()).then(|| Token(text.to_owned()))
    }

    /// The secret itself.
    #[cfg(feature = "fetch")]
    pub(super) fn secret(&self) -> &str {
        &self.0
    }
}

impl Hub {
    /// Obeys `HF_ENDPOINT`, `HF_TOKEN` (else the file `HF_TOKEN_PATH`, else `token` in `HF_HOME`), `HF_HUB_CACHE`
    /// (else `hub` in `HF_HOME`) and `HF_HUB_OFFLINE`; `variable` reads one of them. `HF_HOME` is by default
    /// `huggingface` in `XDG_CACHE_HOME`, else in `.cache` of the home folder.
    ///
    /// # Errors
    /// `InvalidInput` if the endpoint is no address or there is no home folder.
    pub fn from_environment(variable: impl Fn(&str) -> Option<OsString>) -> Result<Hub> {
        let home = hub_home(&variable)?;
        let token = text(&variable, "HF_TOKEN").or_else(|| {
            let file = path(&variable, "HF_TOKEN_PATH").unwrap_or_else(|| home.join("token"));
            fs::read_to_string(file).ok()
        });
        let offline = text(&variable, "HF_HUB_OFFLINE").unwrap_or_default().to_ascii_uppercase();
        Ok(Hub {
            endpoint: endpoint(&text(&variable, "HF_ENDPOINT").unwrap_or(ENDPOINT.to_owned()))?,
            token: token.as_deref().and_then(Token::new),
            cache: path(&variable, "HF_HUB_CACHE").unwrap_or_else(|| home.join("hub")),
            offline: matches!(offline.as_str(), "1" | "ON" | "YES" | "TRUE"),
            pause: PAUSE,
        })
    }

    /// Asks another server.
    ///
    /// # Errors
    /// `InvalidInput` if this is no `http` or `https` address, or holds credentials.
    pub fn with_endpoint(self, address: &str) -> Result<Hub> {
        Ok(Hub { endpoint: endpoint(address)?, ..self })
    }
}

impl Choice {
    /// Where the weights are kept if nothing else is said: beside the cache of the hub, so that files that other
    /// programs have downloaded can be linked instead of copied.
    ///
    /// # Errors
    /// `InvalidInput` if there is no home folder.
    pub fn default_folder(self, variable: impl Fn(&str) -> Option<OsString>) -> Result<PathBuf> {
        Ok(hub_home(&variable)?.join("rare").join(self.name()))
    }
}

fn hub_home(variable: &impl Fn(&str) -> Option<OsString>) -> Result<PathBuf> {
    if let Some(home) = path(variable, "HF_HOME") {
        return Ok(home);
    }
    let cache = path(variable, "XDG_CACHE_HOME").or_else(|| {
        let home = path(variable, "HOME").or_else(|| path(variable, "USERPROFILE"))?;
        Some(home.join(".cache"))
    });
    let missing = "there is no home folder (HOME is not set): name a folder, or set HF_HOME";
    Ok(cache.ok_or_else(|| Error::invalid(missing))?.join("huggingface"))
}

/// An empty variable counts as none.
fn path(variable: &impl Fn(&str) -> Option<OsString>, name: &str) -> Option<PathBuf> {
    let value = variable(name).filter(|value| !value.is_empty())?;
    // Programs write a home folder that no shell has resolved.
    match Path::new(&value).strip_prefix("~") {
        Ok(rest) => Some(PathBuf::from(variable("HOME")?).join(rest)),
        Err(_) => Some(PathBuf::from(value)),
    }
}

fn text(variable: &impl Fn(&str) -> Option<OsString>, name: &str) -> Option<String> {
    variable(name)?.into_string().ok().filter(|value| !value.trim().is_empty())
}

/// The address of a server, as addresses of files begin.
fn endpoint(address: &str) -> Result<String> {
    let address = address.trim().trim_end_matches('/');
    let host = address.strip_prefix("https://").or_else(|| address.strip_prefix("http://"));
    let refuse = |why: &str| Err(Error::invalid(format!("endpoint {address}: {why}")));
    match host {
        // Not repeated: it holds a secret.
        Some(host) if host.contains('@') => Err(Error::invalid(
            "the endpoint holds a user name or password: leave them out and set HF_TOKEN",
        )),
        None | Some("") => refuse("not an address: write https://HOST"),
        Some(host) if host.contains(['?', '#', ' ']) => {
            refuse("an address without a query is needed: write https://HOST")
        }
        Some(_) => Ok(address.to_owned()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn hub(variables: &[(&str, &str)]) -> Result<Hub> {
        Hub::from_environment(|name| {
            let found = variables.iter().find(|(own, _)| *own == name)?;
            Some(OsString::from(found.1))
        })
    }

    #[test]
    fn the_variables_of_the_hub_are_obeyed() {
        let plain = hub(&[("HOME", "/home/me")]).unwrap();
        assert_eq!((plain.endpoint.as_str(), plain.offline), (ENDPOINT, false));
        assert_eq!(plain.cache, Path::new("/home/me/.cache/huggingface/hub"));
        let moved = hub(&[("HF_HOME", "/data"), ("HF_ENDPOINT", "http://mirror:80/")]).unwrap();
        assert_eq!(
            (moved.cache.as_path(), &*moved.endpoint),
            (Path::new("/data/hub"), "http://mirror:80")
        );
        let cache = hub(&[("HF_HOME", "/data"), ("HF_HUB_CACHE", "/big")]).unwrap().cache;
        assert_eq!(cache, Path::new("/big"));
        let home = hub(&[("HF_HOME", "~/hub"), ("HOME", "/home/me")]).unwrap().cache;
        assert_eq!(home, Path::new("/home/me/hub/hub"));
        let xdg = hub(&[("XDG_CACHE_HOME", "/x"), ("HOME", "/home/me")]).unwrap().cache;
        assert_eq!(xdg, Path::new("/x/huggingface/hub"));
        for (value, offline) in [("1", true), ("true", true), ("on", true), ("0", false)] {
            let hub = hub(&[("HF_HOME", "/data"), ("HF_HUB_OFFLINE", value)]).unwrap();
            assert_eq!(hub.offline, offline, "{value}");
        }
        assert!(hub(&[]).unwrap_err().to_string().contains("HF_HOME"));
    }

    #[test]
    fn the_token_is_found_and_never_printed() {
        let folder = tempfile::tempdir().unwrap();
        let home = folder.path().to_str().unwrap();
        assert_eq!(hub(&[("HF_HOME", home)]).unwrap().token, None);
        fs::write(folder.path().join("token"), "hf_file\n").unwrap();
        assert_eq!(hub(&[("HF_HOME", home)]).unwrap().token, Token::new("hf_file"));
        let named = hub(&[("HF_HOME", home), ("HF_TOKEN", " hf_named ")]).unwrap();
        assert_eq!(named.token, Token::new("hf_named"));
        assert!(!format!("{named:?}").contains("hf_named"));
    }

    #[test]
    fn an_endpoint_is_an_address_without_secrets() {
        let plain = hub(&[("HF_HOME", "/data")]).unwrap();
        for (address, word) in [
            ("hub.example.org", "https://"),
            ("https://", "https://"),
            ("https://example.org?a=b", "query"),
            ("https://me:secret@example.org", "HF_TOKEN"),
        ] {
            let message = plain.clone().with_endpoint(address).unwrap_err().to_string();
            assert!(message.contains(word) && !message.contains("secret"), "{message}");
        }
    }
}
