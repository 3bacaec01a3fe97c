//! A small server on this machine that speaks the hub's protocol of downloads, and makes the mistakes it is told to.

use std::collections::BTreeMap;
use std::io::{BufRead, BufReader, Write};
use std::net::{TcpListener, TcpStream};
use std::path::Path;
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::Duration;

use sha1::Sha1;
use sha2::{Digest, Sha256};

/// The commit of every repository.
pub(crate) const COMMIT: &str = "0123456789abcdef0123456789abcdef01234567";
/// What each source has, with `.safetensors` kept large enough to break off in the middle.
const STABLE_DIFFUSION: [&str; 10] = [
    "model_index.json",
    "scheduler/scheduler_config.json",
    "tokenizer/merges.txt",
    "tokenizer/vocab.json",
    "text_encoder/config.json",
    "text_encoder/model.fp16.safetensors",
    "text_encoder/model.safetensors",
    "unet/config.json",
    "unet/diffusion_pytorch_model.fp16.safetensors",
    "unet/diffusion_pytorch_model.safetensors",
];
const CONTROLNET: [&str; 3] = [
    "config.json",
    "diffusion_pytorch_model.fp16.safetensors",
    "diffusion_pytorch_model.safetensors",
];

/// A mistake of the server, in all files whose path contains a word.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Fault {
    /// The connection breaks after so many bytes of a body, so many times.
    Break { after: usize, times: usize },
    /// Nothing more comes after so many bytes of a body, but the connection stays.
    Stall { after: usize },
    /// Another content of the same length.
    WrongContent,
    /// One byte more or less than announced, with a header that admits it.
    WrongLength(isize),
    /// The length of a body is not said: it ends with the connection.
    NoLength,
    /// There is no such file.
    NotFound,
    /// Only with a token.
    Locked,
    /// Requests for a part get the whole.
    NoParts,
    /// Busy, so many times.
    Busy { times: usize },
    /// The announcement has no hash.
    NoHash,
    /// The announcement is of another commit.
    OtherCommit,
    /// The announcement sends to another address on the server first.
    Moved,
}

/// A request as it arrived.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Request {
    pub(crate) method: String,
    pub(crate) path: String,
    pub(crate) range: Option<String>,
    pub(crate) token: Option<String>,
}

#[derive(Default)]
struct State {
    repositories: BTreeMap<String, BTreeMap<String, Vec<u8>>>,
    faults: Vec<(String, Fault)>,
    requests: Vec<Request>,
}

/// The server; it ends with the tests.
pub(crate) struct Server {
    port: u16,
    state: Arc<Mutex<State>>,
}

impl Server {
    /// Serves made-up files under the names of the published ones.
    pub(crate) fn start() -> Server {
        Server::serve(content)
    }

    /// Serves the files of a pipeline folder in single precision under the names of the published ones.
    pub(crate) fn start_with(folder: &Path) -> Server {
        Server::serve(|repository, path| {
            let part = if repository.starts_with("lllyasviel/") { "controlnet" } else { "" };
            std::fs::read(folder.join(part).join(path.replace(".fp16.", "."))).unwrap()
        })
    }

    fn serve(content: impl Fn(&str, &str) -> Vec<u8>) -> Server {
        let mut state = State::default();
        let names = [
            ("stable-diffusion-v1-5/stable-diffusion-v1-5", &STABLE_DIFFUSION[..]),
            ("lllyasviel/control_v11f1p_sd15_depth", &CONTROLNET),
            ("lllyasviel/sd-controlnet-depth", &CONTROLNET),
        ];
        for (repository, paths) in names {
            let file = |path: &&str| ((*path).to_owned(), content(repository, path));
            state.repositories.insert(repository.to_owned(), paths.iter().map(file).collect());
        }
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let port = listener.local_addr().unwrap().port();
        let state = Arc::new(Mutex::new(state));
        let shared = Arc::clone(&state);
        thread::spawn(move || {
            for stream in listener.incoming().flatten() {
                let shared = Arc::clone(&shared);
                thread::spawn(move || answer(stream, port, &shared));
            }
        });
        Server { port, state }
    }

    pub(crate) fn endpoint(&self) -> String {
        format!("http://127.0.0.1:{}", self.port)
    }

    /// Makes a mistake from now on.
    pub(crate) fn fail(&self, word: &str, fault: Fault) {
        self.state.lock().unwrap().faults.push((word.to_owned(), fault));
    }

    /// Makes no more mistakes.
    pub(crate) fn recover(&self) {
        self.state.lock().unwrap().faults.clear();
    }

    /// Takes a file out of its repository.
    pub(crate) fn remove(&self, repository: &str, path: &str) {
        let mut state = self.state.lock().unwrap();
        state.repositories.get_mut(repository).unwrap().remove(path).unwrap();
    }

    /// The requests since the last call.
    pub(crate) fn requests(&self) -> Vec<Request> {
        std::mem::take(&mut self.state.lock().unwrap().requests)
    }
}

/// What a file holds: different for each, and long for weights.
pub(crate) fn content(repository: &str, path: &str) -> Vec<u8> {
    let line = format!("{repository} {path}\n");
    let bytes = if is_large(path) { 300_000 } else { 100 };
    line.bytes().cycle().take(bytes).collect()
}

pub(crate) fn is_large(path: &str) -> bool {
    path.ends_with(".safetensors")
}

/// The hash under which the hub announces a file.
pub(crate) fn tag(path: &str, content: &[u8]) -> String {
    let hexadecimal = |hash: &[u8]| hash.iter().map(|byte| format!("{byte:02x}")).collect();
    if is_large(path) {
        return hexadecimal(&Sha256::digest(content));
    }
    let mut hasher = Sha1::new();
    hasher.update(format!("blob {}\0", content.len()));
    hasher.update(content);
    hexadecimal(&hasher.finalize())
}

fn answer(stream: TcpStream, port: u16, state: &Mutex<State>) {
    let Some(request) = read_request(&stream) else { return };
    let mut state = state.lock().unwrap();
    state.requests.push(request.clone());
    // A client that has seen enough closes the connection.
    let _ = if let Some(rest) = request.path.strip_prefix("/api/models/") {
        let repository = rest.strip_suffix("/revision/main").unwrap_or(rest);
        let repository =
            repository.strip_suffix(&format!("/revision/{COMMIT}")).unwrap_or(repository);
        list(stream, &mut state, repository, &request)
    } else if let Some(rest) = request.path.strip_prefix("/hosted/") {
        send_file(stream, &mut state, rest, &request)
    } else {
        resolve(stream, &mut state, port, &request)
    };
}

fn read_request(stream: &TcpStream) -> Option<Request> {
    let mut lines = BufReader::new(stream).lines();
    let first = lines.next()?.ok()?;
    let mut words = first.split(' ').map(str::to_owned);
    let (method, path) = (words.next()?, words.next()?);
    let mut request = Request { method, path, range: None, token: None };
    for line in lines {
        let line = line.ok()?;
        let Some((name, value)) = line.split_once(": ") else { break };
        match name.to_ascii_lowercase().as_str() {
            "range" => request.range = Some(value.to_owned()),
            "authorization" => request.token = Some(value.to_owned()),
            _ => {}
        }
    }
    Some(request)
}

/// Sends a status, headers and a body.
fn send(
    mut stream: TcpStream,
    status: &str,
    headers: &[(&str, String)],
    body: &[u8],
) -> std::io::Result<()> {
    let mut head = format!("HTTP/1.1 {status}\r\nConnection: close\r\n");
    for (name, value) in headers {
        head += &format!("{name}: {value}\r\n");
    }
    stream.write_all(format!("{head}\r\n").as_bytes())?;
    stream.write_all(body)
}

fn send_status(stream: TcpStream, status: &str) -> std::io::Result<()> {
    send(stream, status, &[("Content-Length", "0".to_owned())], b"")
}

/// The faults that concern this path; counts down those that end.
fn faults(state: &mut State, path: &str) -> Vec<Fault> {
    let concerned = |(word, _): &&mut (String, Fault)| path.contains(word.as_str());
    let mut found = Vec::new();
    for (_, fault) in state.faults.iter_mut().filter(concerned) {
        found.push(*fault);
        if let Fault::Busy { times } = fault {
            *times = times.saturating_sub(1);
        }
    }
    found.retain(|fault| *fault != Fault::Busy { times: 0 });
    found
}

/// The status of a refusal.
fn refusal(faults: &[Fault], request: &Request) -> Option<&'static str> {
    let locked =
        faults.contains(&Fault::Locked) && request.token.as_deref() != Some("Bearer hf_good");
    if locked {
        Some("401 Unauthorized")
    } else if faults.contains(&Fault::NotFound) {
        Some("404 Not Found")
    } else if faults.iter().any(|fault| matches!(fault, Fault::Busy { .. })) {
        Some("503 Service Unavailable")
    } else {
        None
    }
}

fn list(
    stream: TcpStream,
    state: &mut State,
    repository: &str,
    request: &Request,
) -> std::io::Result<()> {
    let faults = faults(state, &request.path);
    let Some(files) = state.repositories.get(repository) else {
        return send_status(stream, "404 Not Found");
    };
    if let Some(status) = refusal(&faults, request) {
        return send_status(stream, status);
    }
    let names: Vec<String> =
        files.keys().map(|path| format!("{{\"rfilename\": \"{path}\"}}")).collect();
    let body = format!("{{\"sha\": \"{COMMIT}\", \"siblings\": [{}]}}", names.join(", "));
    let length = ("Content-Length", body.len().to_string());
    send(stream, "200 OK", &[length], body.as_bytes())
}

/// Announces a file; sends a small one and sends on to a large one.
fn resolve(
    stream: TcpStream,
    state: &mut State,
    port: u16,
    request: &Request,
) -> std::io::Result<()> {
    let whole = request.path.trim_start_matches('/').replacen("moved/", "", 1);
    let found = whole.split_once(&format!("/resolve/{COMMIT}/"));
    let faults = faults(state, &request.path);
    let content =
        found.and_then(|(repository, path)| state.repositories.get(repository)?.get(path));
    let (Some((repository, path)), Some(content)) = (found, content) else {
        return send_status(stream, "404 Not Found");
    };
    if let Some(status) = refusal(&faults, request) {
        return send_status(stream, status);
    }
    if faults.contains(&Fault::Moved) && !request.path.starts_with("/moved/") {
        let moved = ("Location", format!("/moved/{whole}"));
        return send(
            stream,
            "307 Temporary Redirect",
            &[moved, ("Content-Length", "0".into())],
            b"",
        );
    }
    let commit =
        if faults.contains(&Fault::OtherCommit) { "f".repeat(40) } else { COMMIT.to_owned() };
    let mut headers = vec![("X-Repo-Commit", commit)];
    let quoted = format!("\"{}\"", tag(path, content));
    if is_large(path) {
        // Another name of the same host, as the files of the hub are on other hosts.
        let location = format!("http://localhost:{port}/hosted/{repository}/{path}");
        headers.push(("Location", location));
        headers.push(("Content-Length", "0".to_owned()));
        headers.push(("X-Linked-Size", content.len().to_string()));
        if !faults.contains(&Fault::NoHash) {
            headers.push(("X-Linked-ETag", quoted));
        }
        return send(stream, "302 Found", &headers, b"");
    }
    headers.push(("ETag", quoted));
    headers.push(("Content-Length", content.len().to_string()));
    let body = if request.method == "HEAD" { &[][..] } else { content };
    send(stream, "200 OK", &headers, body)
}

/// Sends the content of a large file, or a part of it, with the mistakes of the day.
fn send_file(
    mut stream: TcpStream,
    state: &mut State,
    rest: &str,
    request: &Request,
) -> std::io::Result<()> {
    let faults = faults(state, rest);
    let of = |(name, files): (&String, &BTreeMap<String, Vec<u8>>)| {
        files.get(rest.strip_prefix(name.as_str())?.trim_start_matches('/')).cloned()
    };
    let Some(mut content) = state.repositories.iter().find_map(of) else {
        return send_status(stream, "404 Not Found");
    };
    for fault in &faults {
        match fault {
            Fault::WrongContent => content[7] ^= 1,
            Fault::WrongLength(more) => content.resize(content.len().strict_add_signed(*more), 0),
            _ => {}
        }
    }
    let total = content.len();
    let start = request.range.as_deref().filter(|_| !faults.contains(&Fault::NoParts));
    let start = start.map(|range| range["bytes=".len()..].trim_end_matches('-').parse().unwrap());
    let status = if start.is_some() { "206 Partial Content" } else { "200 OK" };
    let body = &content[start.unwrap_or(0)..];
    let mut headers = vec![("Content-Length", body.len().to_string())];
    if faults.contains(&Fault::NoLength) {
        headers.clear();
    }
    if let Some(start) = start {
        headers.push(("Content-Range", format!("bytes {start}-{}/{total}", total - 1)));
    }
    for fault in &faults {
        if let Fault::Stall { after } = fault {
            let open = stream.try_clone()?;
            thread::spawn(move || {
                thread::sleep(Duration::from_secs(60));
                drop(open);
            });
            return send(stream, status, &headers, &body[..*after]);
        }
    }
    for (word, fault) in &mut state.faults {
        if let Fault::Break { after, times } = fault
            && *times > 0
            && rest.contains(word.as_str())
        {
            *times -= 1;
            let after = *after;
            send(stream.try_clone()?, status, &headers, &body[..after.min(body.len())])?;
            return stream.flush();
        }
    }
    send(stream, status, &headers, body)
}
