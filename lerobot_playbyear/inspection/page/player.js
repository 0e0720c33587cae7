// Plays an episode's film, and says at every moment what time it is.

class Player {
  constructor(video, onTime) {
    Object.assign(this, { video, onTime, episode: null, frame: 0, loop: false, wantsToPlay: false });
    video.addEventListener("play", () => this.follow());
    video.addEventListener("pause", () => onTime(this.frame / fps));
    video.addEventListener("ended", () => this.ended());
  }
  get playing() {
    return !this.video.paused && !this.video.ended;
  }
  async load(episode, frame, play) {
    URL.revokeObjectURL(this.url);
    this.episode = episode;
    this.wantsToPlay = play;
    this.video.src = this.url = filmOf(episode.position);
    this.video.playbackRate = this.video.defaultPlaybackRate;
    await new Promise((resolve) => {
      this.video.onloadeddata = resolve;
      this.video.onerror = resolve; // a browser without the codec: everything but the film still works
    });
    if (this.episode !== episode) return;
    this.show(frame);
    if (play) this.play();
  }
  play() {
    if (this.frame >= this.episode.frames - 1) this.show(0);
    this.wantsToPlay = true;
    this.video.play().catch(() => this.onTime(this.frame / fps));
  }
  toggle() {
    if (this.playing) this.show(this.frame);
    else this.play();
  }
  // Pauses on a frame; the film is asked for the middle of it, the cursor stands where its picture was taken.
  show(frame) {
    this.wantsToPlay = false;
    this.video.pause();
    this.frame = Math.min(Math.max(frame, 0), this.episode.frames - 1);
    this.video.currentTime = (this.frame + 0.5) / fps;
    this.onTime(this.frame / fps);
  }
  seek(time) {
    const play = this.wantsToPlay;
    this.show(Math.round(time * fps));
    if (play) this.play();
  }
  follow() {
    if (!this.playing) return;
    const time = Math.min(this.video.currentTime, this.episode.duration);
    this.frame = Math.min(Math.floor(time * fps + 1e-6), this.episode.frames - 1);
    this.onTime(time);
    requestAnimationFrame(() => this.follow());
  }
  ended() {
    this.frame = this.episode.frames - 1;
    this.wantsToPlay = this.loop;
    if (this.loop) this.play();
    else this.onTime(this.frame / fps);
  }
}
