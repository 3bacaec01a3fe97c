//! Whatever goes wrong: the message names the file and the remedy, and nothing has the name of a file that is not one.

use std::fs;

use rare_nets::weights::{Token, check};

use super::workplace::{CONTROLNET, STABLE_DIFFUSION, UNET, Workplace, bodies};
use crate::weights_server::{COMMIT, Fault, Request, content, tag};

#[test]
fn a_broken_connection_is_continued_where_it_broke() {
    let workplace = Workplace::new();
    workplace.server.fail("unet/", Fault::Break { after: 100_000, times: 2 });
    let run = workplace.fetch();
    assert_eq!(fs::read(workplace.path(UNET)).unwrap(), content(STABLE_DIFFUSION, UNET));
    let requests = workplace.server.requests();
    let of_unet = |request: &&&Request| request.path.ends_with(UNET);
    let ranges: Vec<_> =
        bodies(&requests).iter().filter(of_unet).map(|request| request.range.clone()).collect();
    let from = |start: u32| Some(format!("bytes={start}-"));
    assert_eq!(ranges, [None, from(100_000), from(200_000)]);
    assert_eq!(run.count("retry"), 2);
    check(&workplace.folder()).unwrap();
}

#[test]
fn a_connection_that_stays_broken_leaves_a_part_that_the_next_run_continues() {
    let workplace = Workplace::new();
    workplace.server.fail("unet/", Fault::Break { after: 90_000, times: 1 });
    workplace.server.fail("unet/", Fault::Break { after: 0, times: usize::MAX });
    workplace.refuse(UNET, &[UNET, "connection broke", "90000 of 300000 bytes", "fetch again"]);
    assert_eq!(fs::metadata(&workplace.parts()[0]).unwrap().len(), 90_000);
    let message = check(&workplace.folder()).unwrap_err().to_string();
    assert!(message.contains(UNET) && message.contains("fetch the weights again"), "{message}");
    workplace.server.recover();
    workplace.server.requests();
    workplace.fetch().lock();
    let requests = workplace.server.requests();
    assert_eq!(bodies(&requests)[0].range.as_deref(), Some("bytes=90000-"));
    check(&workplace.folder()).unwrap();
}

#[test]
fn a_server_that_knows_no_parts_starts_anew() {
    let workplace = Workplace::new();
    workplace.server.fail("unet/", Fault::Break { after: 90_000, times: 1 });
    workplace.server.fail("unet/", Fault::NoParts);
    workplace.fetch().lock();
    assert_eq!(fs::read(workplace.path(UNET)).unwrap(), content(STABLE_DIFFUSION, UNET));
}

#[test]
fn a_wrong_content_is_removed() {
    let workplace = Workplace::new();
    workplace.server.fail("unet/", Fault::WrongContent);
    workplace.refuse(UNET, &[UNET, "SHA-256", "removed", "fetch again"]);
    assert!(workplace.parts().is_empty());
    workplace.server.recover();
    workplace.fetch().lock();
}

#[test]
fn a_part_that_was_damaged_is_found_out() {
    let workplace = Workplace::new();
    workplace.server.fail("unet/", Fault::Break { after: 90_000, times: 1 });
    workplace.server.fail("unet/", Fault::Break { after: 0, times: usize::MAX });
    workplace.refuse(UNET, &[]);
    fs::write(&workplace.parts()[0], [0; 5000]).unwrap();
    workplace.server.recover();
    workplace.refuse(UNET, &["SHA-256"]);
    // A part that is too long is none.
    let part = workplace.path(UNET).with_file_name(format!(
        "diffusion_pytorch_model.fp16.safetensors.{}.part",
        &tag(UNET, &content(STABLE_DIFFUSION, UNET))[..16]
    ));
    fs::write(&part, vec![0; 300_001]).unwrap();
    workplace.fetch().lock();
    assert!(!part.exists());
}

#[test]
fn a_wrong_length_is_refused() {
    for more in [-1, 1] {
        let workplace = Workplace::new();
        workplace.server.fail("unet/", Fault::WrongLength(more));
        let sent = (300_000 + more).to_string();
        workplace.refuse(UNET, &[UNET, &sent, "announced were 300000"]);
        assert!(workplace.parts().is_empty());
    }
}

#[test]
fn a_length_that_is_not_said_is_counted() {
    let workplace = Workplace::new();
    workplace.server.fail("unet/", Fault::WrongLength(5));
    workplace.server.fail("unet/", Fault::NoLength);
    workplace.refuse(UNET, &[UNET, "300001 bytes instead of 300000", "removed"]);
    assert!(workplace.parts().is_empty());
}

#[test]
fn a_file_that_is_not_there_is_named() {
    let workplace = Workplace::new();
    workplace.server.fail("unet/config.json", Fault::NotFound);
    workplace.refuse("unet/config.json", &["unet/config.json", "404", "HF_ENDPOINT"]);
    let workplace = Workplace::new();
    workplace.server.remove(STABLE_DIFFUSION, UNET);
    workplace.server.remove(STABLE_DIFFUSION, "unet/diffusion_pytorch_model.safetensors");
    workplace.refuse(UNET, &[UNET, STABLE_DIFFUSION, COMMIT, "no such file"]);
}

#[test]
fn a_locked_repository_asks_for_licence_and_token() {
    let mut workplace = Workplace::new();
    workplace.server.fail(CONTROLNET, Fault::Locked);
    let config = "controlnet/config.json";
    let page = format!("{}/{CONTROLNET}", workplace.server.endpoint());
    workplace.refuse(config, &[&page, "401", "accept the licence", "set HF_TOKEN to a token"]);
    workplace.hub.token = Token::new("hf_bad");
    let run = workplace.refuse(config, &["401", "account of the token in HF_TOKEN"]);
    assert!(!run.outcome.unwrap_err().to_string().contains("hf_bad"));
    workplace.hub.token = Token::new("hf_good");
    workplace.server.requests();
    let lock = workplace.fetch();
    // The host of the files never sees the token, and neither does the record.
    let requests = workplace.server.requests();
    assert!(!bodies(&requests).is_empty());
    assert!(bodies(&requests).iter().all(|request| request.token.is_none()));
    assert!(!format!("{:?}", lock.lock()).contains("hf_good"));
    let text = fs::read_to_string(workplace.path("rare-weights.json")).unwrap();
    assert!(!text.contains("hf_good"));
    workplace.hub.token = Token::new("two\nlines");
    fs::remove_file(workplace.path(config)).unwrap();
    workplace.refuse(config, &["HF_TOKEN", "one line"]);
}

#[test]
fn a_busy_server_is_asked_again() {
    let workplace = Workplace::new();
    workplace.server.fail("config.json", Fault::Busy { times: 2 });
    workplace.fetch().lock();
    let workplace = Workplace::new();
    workplace.server.fail("unet/config.json", Fault::Busy { times: usize::MAX });
    workplace.refuse("unet/config.json", &["503", "check the network"]);
}

#[test]
fn nobody_at_the_address_is_said_so() {
    let mut workplace = Workplace::new();
    workplace.hub.endpoint = "http://127.0.0.1:1".to_owned();
    workplace.refuse(UNET, &["http://127.0.0.1:1", "check the network", "HF_ENDPOINT"]);
}

#[test]
fn an_announcement_that_cannot_be_verified_is_refused() {
    let workplace = Workplace::new();
    workplace.server.fail(UNET, Fault::NoHash);
    workplace.refuse(UNET, &[UNET, "no hash"]);
    let workplace = Workplace::new();
    workplace.server.fail(UNET, Fault::OtherCommit);
    workplace.refuse(UNET, &[UNET, "commit ffff", COMMIT]);
    let workplace = Workplace::new();
    workplace.server.fail("", Fault::Moved);
    workplace.fetch().lock();
}

/// `/dev/full` fails as a full disk does.
#[cfg(target_os = "linux")]
#[test]
fn a_full_disk_is_said_so() {
    let workplace = Workplace::new();
    fs::create_dir_all(workplace.folder().join("unet")).unwrap();
    let digits = &tag(UNET, &content(STABLE_DIFFUSION, UNET))[..16];
    let part = workplace.folder().join(format!("{UNET}.{digits}.part"));
    std::os::unix::fs::symlink("/dev/full", part).unwrap();
    let words = [UNET, "No space left on device", "300000 bytes", "make room", "another disk"];
    workplace.refuse(UNET, &words);
}

#[test]
fn a_file_that_another_program_fetches_is_left_to_it() {
    let workplace = Workplace::new();
    fs::create_dir_all(workplace.folder().join("unet")).unwrap();
    let digits = &tag(UNET, &content(STABLE_DIFFUSION, UNET))[..16];
    let part = fs::File::create(workplace.folder().join(format!("{UNET}.{digits}.part"))).unwrap();
    part.lock().unwrap();
    workplace.refuse(UNET, &[UNET, "another program"]);
}
