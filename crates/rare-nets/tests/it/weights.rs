//! Fetching and checking weights, against a server of our own.

mod failures;
mod workplace;

use std::fs;
use std::path::Path;

use rare_nets::weights::{Choice, ControlNetVersion, Precision, check, open};

use self::workplace::{CONTROLNET, STABLE_DIFFUSION, UNET, Workplace};
use crate::shared;
use crate::weights_server::{COMMIT, Server, content, is_large, tag};

#[test]
fn a_folder_is_made_of_what_is_published_and_recorded() {
    let workplace = Workplace::new();
    let run = workplace.fetch();
    let lock = run.lock();
    assert_eq!(lock.files().len(), 10);
    for locked in lock.files() {
        let path = locked.file.strip_prefix("controlnet/").unwrap_or(&locked.file);
        let content = content(&locked.repository, path);
        assert_eq!(fs::read(workplace.path(&locked.file)).unwrap(), content);
        assert_eq!((locked.bytes, locked.commit.as_str()), (content.len() as u64, COMMIT));
        if is_large(path) {
            assert_eq!(locked.sha256, tag(path, &content));
        }
        let endpoint = workplace.server.endpoint();
        assert_eq!(locked.url, format!("{endpoint}/{}/resolve/{COMMIT}/{path}", locked.repository));
    }
    assert_eq!((run.count("licence CreativeML OpenRAIL-M"), run.count("Server")), (1, 10));
    assert!(run.told[0].starts_with("licence"), "{:?}", run.told);
    assert!(workplace.parts().is_empty());
    assert_eq!(check(&workplace.folder()).unwrap().lock, *lock);
}

#[test]
fn a_second_run_downloads_nothing_and_asks_nobody() {
    let workplace = Workplace::new();
    workplace.fetch().lock();
    assert!(!workplace.server.requests().is_empty());
    let again = workplace.fetch();
    assert_eq!((again.lock().files().len(), again.count("Folder"), again.told.len()), (10, 10, 10));
    assert_eq!(workplace.server.requests(), []);
}

#[test]
fn precision_and_release_are_chosen_and_not_mixed() {
    let workplace = Workplace::new();
    let choice = Choice { controlnet: ControlNetVersion::V1_0, precision: Precision::F32 };
    let run = workplace.run(choice);
    assert!(run.lock().find("controlnet/diffusion_pytorch_model.safetensors").is_some());
    assert!(run.lock().find(UNET).is_none());
    assert!(run.lock().commit_of("lllyasviel/sd-controlnet-depth").is_some());
    assert!(run.lock().commit_of(CONTROLNET).is_none());
    let message = workplace.fetch().outcome.unwrap_err().to_string();
    assert!(message.contains("v1.0-f32") && message.contains("another folder"), "{message}");
}

#[test]
fn single_precision_serves_where_there_is_no_half() {
    let workplace = Workplace::new();
    workplace.server.remove(CONTROLNET, "diffusion_pytorch_model.fp16.safetensors");
    let run = workplace.fetch();
    let file = "controlnet/diffusion_pytorch_model.safetensors";
    assert!(run.lock().find(file).is_some() && run.count(&format!("single {file}")) == 1);
    check(&workplace.folder()).unwrap();
    workplace.fetch().lock();
}

#[test]
fn files_of_other_programs_are_found_and_shared() {
    let workplace = Workplace::new();
    workplace.cache(STABLE_DIFFUSION, UNET, &content(STABLE_DIFFUSION, UNET));
    let run = workplace.fetch();
    assert_eq!((run.count(&format!("end {UNET} Cache")), run.count("Server")), (1, 9));
    assert!(
        workplace
            .server
            .requests()
            .iter()
            .all(|request| !request.path.ends_with(&format!("hosted/{STABLE_DIFFUSION}/{UNET}")))
    );
    #[cfg(unix)]
    {
        use std::os::unix::fs::MetadataExt;
        assert_eq!(fs::metadata(workplace.path(UNET)).unwrap().nlink(), 2);
    }
    // A damaged one is not taken.
    let workplace = Workplace::new();
    workplace.cache(STABLE_DIFFUSION, UNET, &content(STABLE_DIFFUSION, UNET));
    let blobs =
        workplace.hub.cache.join(format!("models--{}/blobs", STABLE_DIFFUSION.replace('/', "--")));
    let blob = fs::read_dir(blobs).unwrap().next().unwrap().unwrap().path();
    fs::write(blob, "damaged").unwrap();
    assert_eq!(workplace.fetch().count(&format!("end {UNET} Server")), 1);
}

#[test]
fn offline_the_cache_is_all_there_is() {
    let mut workplace = Workplace::new();
    workplace.hub.offline = true;
    workplace.refuse(UNET, &[STABLE_DIFFUSION, "HF_HUB_OFFLINE"]);
    let lay = |workplace: &Workplace, skip: &str| {
        for source in Choice::default().sources() {
            for file in source.files_in(Precision::F16).filter(|file| file.path != skip) {
                let content = content(source.repository, file.path);
                workplace.cache(source.repository, file.path, &content);
            }
        }
    };
    lay(&workplace, UNET);
    workplace.refuse(UNET, &[UNET, COMMIT, "not in the cache", "unset HF_HUB_OFFLINE"]);
    workplace.cache(STABLE_DIFFUSION, UNET, b"damaged but rightly named?");
    let run = workplace.fetch();
    assert_eq!(run.count(&format!("end {UNET} Cache")), 1);
    assert_eq!(workplace.server.requests(), []);
    check(&workplace.folder()).unwrap();
}

#[test]
fn a_file_of_the_user_is_not_overwritten() {
    let workplace = Workplace::new();
    fs::create_dir_all(workplace.folder().join("unet")).unwrap();
    fs::write(workplace.path(UNET), "my own").unwrap();
    let message = workplace.fetch().outcome.unwrap_err().to_string();
    assert!(message.contains(UNET) && message.contains("move it away"), "{message}");
    assert_eq!(fs::read(workplace.path(UNET)).unwrap(), b"my own");
    // One that is the published one is taken as it is.
    fs::write(workplace.path(UNET), content(STABLE_DIFFUSION, UNET)).unwrap();
    assert_eq!(workplace.fetch().count(&format!("end {UNET} Folder")), 1);
}

#[test]
fn a_check_finds_what_has_changed() {
    let workplace = Workplace::new();
    let message = check(&workplace.folder()).unwrap_err().to_string();
    assert!(message.contains("rare-weights.json") && message.contains("fetch"), "{message}");
    workplace.fetch().lock();
    let refuse = |change: &dyn Fn(&Path), word: &str| {
        let right = fs::read(workplace.path(UNET)).unwrap();
        change(&workplace.path(UNET));
        let message = check(&workplace.folder()).unwrap_err().to_string();
        assert!(message.contains(UNET) && message.contains(word), "{message}");
        fs::write(workplace.path(UNET), right).unwrap();
        check(&workplace.folder()).unwrap();
    };
    refuse(&|path| fs::write(path, vec![0; 300_000]).unwrap(), "SHA-256");
    refuse(&|path| fs::write(path, "short").unwrap(), "5 bytes, recorded were 300000");
    refuse(&|path| fs::remove_file(path).unwrap(), "no such file");
}

#[test]
fn a_fetched_pipeline_opens_and_misfits_are_named() {
    let Some(folder) = shared::path("golden/rare/tiny-pipeline") else { return };
    let workplace = Workplace::with(Server::start_with(&folder));
    workplace.fetch().lock();
    check(&workplace.folder()).unwrap();
    let pipeline = open(&workplace.folder()).unwrap();
    assert!(pipeline.files.contains(&workplace.path(UNET)), "{:?}", pipeline.files);
    let config = workplace.path("text_encoder/config.json");
    let text = fs::read_to_string(&config).unwrap();
    let layers = |count: u32| format!("\"num_hidden_layers\": {count}");
    assert!(text.contains(&layers(3)), "{text}");
    fs::write(&config, text.replace(&layers(3), &layers(4))).unwrap();
    let message = open(&workplace.folder()).unwrap_err().to_string();
    for word in ["text encoder", "missing", "text_model.encoder.layers.3."] {
        assert!(message.contains(word), "{word} is missing in {message}");
    }
}
