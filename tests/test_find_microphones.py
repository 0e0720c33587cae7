"""playbyear-find-microphones lists sound cards as they are chosen, and hears each."""

import time

import numpy as np
import pytest
from sound_server import RATE, Player, started, why_not

from lerobot_playbyear.datasets.audio_files import read_audio
from lerobot_playbyear.datasets.errors import InputError
from lerobot_playbyear.microphones.finding import (
    FindMicrophonesConfig,
    described,
    find_microphones,
    level_text,
    suggested_device,
)
from lerobot_playbyear.microphones.microphone import MicrophoneError
from lerobot_playbyear.microphones.portaudio import SoundCard, cards_called, sound_cards

needs_server = pytest.mark.skipif(bool(why_not()), reason=why_not())


@needs_server
def test_each_card_is_listed_heard_and_written(tmp_path, capsys):
    loud = np.full((20 * RATE, 2), [8000, 1], np.int16)  # for longer than a slow machine needs
    with (
        started(bench=2, table=1) as server,
        Player(server.fifo("bench"), 2) as bench,
        Player(server.fifo("table"), 1, noise=0),
    ):
        bench.play(loud, time.perf_counter())
        find_microphones(FindMicrophonesConfig(seconds=0.5, output_dir=tmp_path))
    said = capsys.readouterr().out
    assert "0: bench, ALSA (default)" in said
    assert "sample rates: 8000, 16000, 32000, 44100, 48000, 96000 Hz" in said
    assert "--robot.cameras='{mic: {type: microphone, device: \"table, ALSA\", sample_rate: 16000}}'" in said
    assert said.count("nothing but zeros") == 1
    samples, rate = read_audio(tmp_path / "microphone_0.wav")
    assert rate == 16000
    assert len(samples) == 0.5 * rate
    assert np.median(samples, axis=0).tolist() == pytest.approx([8000, 1], abs=3)


@needs_server
def test_listing_opens_nothing(tmp_path, capsys):
    with started(bench=2):
        find_microphones(FindMicrophonesConfig(list=True, output_dir=tmp_path / "none"))
    assert "bench" in capsys.readouterr().out
    assert not (tmp_path / "none").exists()


@needs_server
def test_a_card_that_cannot_be_opened_is_told_and_the_others_are_heard(tmp_path, capsys):
    with started(bench=1, table=1) as server, Player(server.fifo("table"), 1):
        server.remove("bench")
        find_microphones(FindMicrophonesConfig(seconds=0.3, output_dir=tmp_path))
        assert "bench, ALSA cannot be opened" in capsys.readouterr().out
        assert [path.name for path in tmp_path.iterdir()] == ["microphone_1.wav"]
        server.remove("table")
        with pytest.raises(MicrophoneError, match="None of these"):
            find_microphones(FindMicrophonesConfig(seconds=0.3, output_dir=tmp_path))


@needs_server
def test_where_there_is_no_card_it_says_what_to_do():
    with started():
        if sound_cards():
            pytest.skip("this machine has a sound card")
        with pytest.raises(MicrophoneError, match="Plug a microphone in"):
            find_microphones(FindMicrophonesConfig())


def test_the_meter_shows_each_channel_from_minus_60_db_to_full_scale():
    samples = np.zeros((100, 4), np.int16)
    samples[0] = [0, 33, 3277, 32767]
    assert level_text(samples).split("  ") != level_text(samples[1:]).split("  ")
    said = level_text(samples)
    assert "zeros" in said
    assert "-60 dB" in said
    assert "-20 dB" in said
    assert f"[{'#' * 20}]  clips" in said


def plugged_in(*names: str) -> list[SoundCard]:
    return [SoundCard(number, name, 1, 48000, False) for number, name in enumerate(names)]


def test_the_name_that_is_suggested_holds_in_another_order_of_plugging():
    """ALSA numbers cards as they come, and one's name may be a part of another's."""
    before = plugged_in("USB Mic: Audio (hw:1,0), ALSA", "My USB Mic: Audio (hw:2,0), ALSA", "pulse, ALSA")
    after = plugged_in("My USB Mic: Audio (hw:0,0), ALSA", "pulse, ALSA", "USB Mic: Audio (hw:3,0), ALSA")
    suggested = [suggested_device(card, before) for card in before]
    assert suggested == [("USB Mic: Audio", True), ("My USB Mic: Audio", True), ("pulse, ALSA", True)]
    assert [cards_called(name, after) for name, _ in suggested] == [[after[2]], [after[0]], [after[1]]]


@pytest.mark.parametrize(
    ("names", "device"),
    [
        (("USB Mic: Audio (hw:1,0), ALSA", "USB Mic: Audio (hw:2,0), ALSA"), "USB Mic: Audio (hw:1,0), ALSA"),
        (("USB Mic, Core Audio", "USB Mic, Core Audio"), "0"),
    ],
)
def test_cards_that_cannot_be_told_apart_are_told_to_be_so(names, device):
    cards = plugged_in(*names)
    *_, option, warning = described(cards[0], (48000,), cards)
    assert f'device: "{device}"' in option
    assert "may swap after a restart" in warning
    assert len(cards_called(cards[0].lasting_name, cards)) == 2


def test_a_name_with_quotes_stays_one_name():
    card = SoundCard(1, 'The "good" one', 1, 44100, False)
    (*_, option) = described(card, (44100,), [card])
    assert 'device: "The \\"good\\" one", sample_rate: 44100' in option


def test_seconds_without_meaning_are_refused():
    with pytest.raises(InputError, match="seconds=0"):
        find_microphones(FindMicrophonesConfig(seconds=0))
