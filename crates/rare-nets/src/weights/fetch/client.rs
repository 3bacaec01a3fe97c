//! What is asked of the hub, and what its answers mean.

use std::collections::BTreeSet;
use std::io::{self, Read};
use std::time::Duration;

use rare::Error;
use serde::Deserialize;
use ureq::config::RedirectAuthHeaders;
use ureq::http::{HeaderMap, Response, StatusCode};
use ureq::typestate::WithoutBody;
use ureq::{Agent, Body, RequestBuilder};

use super::super::digest::is_hexadecimal;
use super::super::hub::{Hub, Token};
use super::content::ContentHash;

/// A server that does not take a connection for so long is not there.
const CONNECT: Duration = Duration::from_secs(30);
/// A server that sends nothing for so long has stopped.
const SILENCE: Duration = Duration::from_secs(60);
/// The longest list of files that is read, bytes.
const LONGEST_LIST: u64 = 16 << 20;
/// How often a file may have moved within the server.
const MOVES: usize = 5;

/// Why there is no answer.
#[derive(Debug)]
pub(super) enum Failure {
    /// It may work another time.
    Passing(String),
    /// It will not.
    Final(Error),
}

impl From<Error> for Failure {
    fn from(error: Error) -> Failure {
        Failure::Final(error)
    }
}

/// The hub, asked with the token of the user.
pub(super) struct Client {
    agent: Agent,
    endpoint: String,
    token: Option<Token>,
}

/// A file in a commit of a repository.
#[derive(Debug, Clone, Copy)]
pub(super) struct Remote<'a> {
    pub(super) repository: &'a str,
    pub(super) commit: &'a str,
    pub(super) path: &'a str,
}

/// What is in a commit.
#[derive(Debug)]
pub(super) struct Listing {
    pub(super) commit: String,
    pub(super) paths: BTreeSet<String>,
}

/// What a file is, as the server announces it.
#[derive(Debug)]
pub(super) struct Announced {
    pub(super) bytes: u64,
    pub(super) hash: ContentHash,
}

/// The content of a file, from `start` on.
pub(super) struct Opened {
    pub(super) start: u64,
    pub(super) reader: Box<dyn Read>,
}

/// The answer to a question for a repository, as far as it matters.
#[derive(Deserialize)]
struct RepositoryAnswer {
    sha: String,
    siblings: Vec<Sibling>,
}

#[derive(Deserialize)]
struct Sibling {
    rfilename: String,
}

impl Remote<'_> {
    /// Its address on a server.
    pub(super) fn url(&self, endpoint: &str) -> String {
        format!("{endpoint}/{}/resolve/{}/{}", self.repository, self.commit, self.path)
    }
}

impl Client {
    pub(super) fn new(hub: &Hub) -> Client {
        let config = Agent::config_builder()
            // What a status means depends on the question.
            .http_status_as_error(false)
            // The files themselves are on other hosts, which the token does not concern.
            .redirect_auth_headers(RedirectAuthHeaders::SameHost)
            .timeout_connect(Some(CONNECT))
            .timeout_per_read(Some(SILENCE))
            .user_agent(concat!("rare/", env!("CARGO_PKG_VERSION")))
            // A length is that of the file only if nobody compresses it on the way.
            .accept_encoding("identity")
            .build();
        let (endpoint, token) = (hub.endpoint.clone(), hub.token.clone());
        Client { agent: config.into(), endpoint, token }
    }

    /// The address of a file.
    pub(super) fn url(&self, remote: Remote<'_>) -> String {
        remote.url(&self.endpoint)
    }

    /// The files of a repository at a commit or branch.
    pub(super) fn list(&self, repository: &str, revision: &str) -> Result<Listing, Failure> {
        let url = format!("{}/api/models/{repository}/revision/{revision}", self.endpoint);
        let mut response = self.call(self.agent.get(&url), &url)?;
        self.check_status(response.status(), &url, repository)?;
        let body = response.body_mut().with_config().limit(LONGEST_LIST).read_to_vec();
        let body = body.map_err(|error| failure(&url, &error))?;
        let answer: Option<RepositoryAnswer> = serde_json::from_slice(&body).ok();
        match answer.filter(|answer| is_hexadecimal(&answer.sha, 40)) {
            Some(answer) => {
                let paths = answer.siblings.into_iter().map(|file| file.rfilename).collect();
                Ok(Listing { commit: answer.sha, paths })
            }
            None => Err(strange(&url, "no list of files")),
        }
    }

    /// Length and hash of a file.
    pub(super) fn describe(&self, remote: Remote<'_>) -> Result<Announced, Failure> {
        let mut url = self.url(remote);
        for _ in 0..MOVES {
            // The answer that sends on to the host of the file is the one that announces it; that host knows less.
            let request = self.agent.head(&url).config().max_redirects(0).build();
            let response = self.call(request, &url)?;
            match moved_within(&self.endpoint, &response) {
                Some(next) => url = next,
                None => {
                    self.check_status(response.status(), &url, remote.repository)?;
                    return announced(response.headers(), remote, &url);
                }
            }
        }
        Err(strange(&url, "redirects without end"))
    }

    /// The content of a file of `bytes` bytes from `start` on, or from 0 if the server cannot do that.
    pub(super) fn open(
        &self,
        remote: Remote<'_>,
        start: u64,
        bytes: u64,
    ) -> Result<Opened, Failure> {
        let url = self.url(remote);
        let mut request = self.agent.get(&url);
        if start > 0 {
            request = request.header("Range", format!("bytes={start}-"));
        }
        let response = self.call(request, &url)?;
        let status = response.status();
        let (from, total) = match status {
            StatusCode::PARTIAL_CONTENT => content_range(response.headers())
                .filter(|(from, _)| *from == start)
                .ok_or_else(|| strange(&url, "another part than was asked for"))?,
            StatusCode::RANGE_NOT_SATISFIABLE if start > 0 => return self.open(remote, 0, bytes),
            _ => (0, number(response.headers(), "content-length")),
        };
        self.check_status(status, &url, remote.repository)?;
        if let Some(total) = total.filter(|total| *total != bytes) {
            return Err(strange(&url, &format!("{total} bytes, announced were {bytes}")));
        }
        // One more than is left, so that a file that is too long is noticed.
        let rest = bytes.saturating_sub(from).saturating_add(1);
        let reader = response.into_body().into_reader().take(rest);
        Ok(Opened { start: from, reader: Box::new(reader) })
    }

    fn call(
        &self,
        request: RequestBuilder<WithoutBody>,
        url: &str,
    ) -> Result<Response<Body>, Failure> {
        let request = match &self.token {
            Some(token) => request.header("Authorization", format!("Bearer {}", token.secret())),
            None => request,
        };
        request.call().map_err(|error| failure(url, &error))
    }

    /// Whether there is an answer; a redirect is one, to a question for headers.
    fn check_status(&self, status: StatusCode, url: &str, repository: &str) -> Result<(), Failure> {
        let page = format!("{}/{repository}", self.endpoint);
        let why = match status.as_u16() {
            200..=399 => return Ok(()),
            401 | 403 if self.token.is_some() => format!(
                "accept the licence at {page} with the account of the token in HF_TOKEN, or set HF_TOKEN anew"
            ),
            401 | 403 => {
                format!("accept the licence at {page} and set HF_TOKEN to a token of your account")
            }
            404 | 410 => "there is no such file: ask another server with HF_ENDPOINT".to_owned(),
            408 | 429 | 500.. => {
                return Err(Failure::Passing(format!("{url}: the server answers {status}")));
            }
            _ => "check HF_ENDPOINT".to_owned(),
        };
        Err(Failure::Final(Error::invalid(format!("{url}: the server answers {status}: {why}"))))
    }
}

/// What an error of the connection means.
fn failure(url: &str, error: &ureq::Error) -> Failure {
    let what = format!("{url}: {error}");
    match error {
        ureq::Error::Http(_) => Failure::Final(Error::invalid(format!(
            "{what}: check that the token in HF_TOKEN is one line without spaces"
        ))),
        ureq::Error::BadUri(_) | ureq::Error::InvalidProxyUrl => Failure::Final(Error::invalid(
            format!("{what}: check HF_ENDPOINT and the proxy settings"),
        )),
        ureq::Error::Tls(_) | ureq::Error::Rustls(_) => Failure::Final(Error::invalid(format!(
            "{what}: no trusted connection: check the clock and the endpoint"
        ))),
        ureq::Error::BodyExceedsLimit(_) => strange(url, "a list without end"),
        _ => Failure::Passing(what),
    }
}

/// The new address of what has moved within its server, as the hub does with renamed repositories and small files.
fn moved_within(endpoint: &str, response: &Response<Body>) -> Option<String> {
    let location = text(response.headers(), "location")?;
    let within = location.starts_with('/') && !location.starts_with("//");
    let host = endpoint.find("://")? + 3;
    let end = endpoint.get(host..)?.find('/').map_or(endpoint.len(), |slash| host + slash);
    (response.status().is_redirection() && within)
        .then(|| Some(format!("{}{location}", endpoint.get(..end)?)))?
}

/// The announcement in the headers: for large files in those that speak of what is linked.
fn announced(headers: &HeaderMap, remote: Remote<'_>, url: &str) -> Result<Announced, Failure> {
    if let Some(commit) = text(headers, "x-repo-commit").filter(|own| *own != remote.commit) {
        let other = format!("a file of commit {commit:.40}, asked was {}", remote.commit);
        return Err(strange(url, &other));
    }
    let bytes = number(headers, "x-linked-size").or_else(|| number(headers, "content-length"));
    let tag = text(headers, "x-linked-etag").or_else(|| text(headers, "etag"));
    let bytes = bytes.ok_or_else(|| strange(url, "no length of the file"))?;
    let hash = tag.and_then(ContentHash::parse);
    let hash = hash.ok_or_else(|| strange(url, "no hash of the file to verify it with"))?;
    Ok(Announced { bytes, hash })
}

fn text<'a>(headers: &'a HeaderMap, name: &str) -> Option<&'a str> {
    headers.get(name)?.to_str().ok()
}

fn number(headers: &HeaderMap, name: &str) -> Option<u64> {
    text(headers, name)?.trim().parse().ok()
}

/// First byte and total length out of `bytes first-last/total`; a server may not know the total.
fn content_range(headers: &HeaderMap) -> Option<(u64, Option<u64>)> {
    let range = text(headers, "content-range")?.trim().strip_prefix("bytes ")?;
    let (part, total) = range.split_once('/')?;
    Some((part.split_once('-')?.0.trim().parse().ok()?, total.trim().parse().ok()))
}

fn strange(url: &str, what: &str) -> Failure {
    Failure::Final(Error::invalid(format!(
        "{url}: the server sends {what}: try again later, or another server with HF_ENDPOINT"
    )))
}

/// The words of an error of a connection.
pub(super) fn broken(url: &str, error: &io::Error) -> Failure {
    Failure::Passing(format!("{url}: the connection broke ({error})"))
}
