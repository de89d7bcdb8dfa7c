// SPDX-License-Identifier: BSD-3-Clause
// What scenarios wait for.

export function once(emitter, event) {
  return new Promise((resolve) => emitter.once(event, resolve));
}

// The first so many messages of a topic, which is subscribed to meanwhile.
export function collect(topic, count) {
  return new Promise((resolve) => {
    const messages = [];
    const take = (message) => {
      messages.push(message);
      if (messages.length === count) {
        topic.unsubscribe(take);
        resolve(messages);
      }
    };
    topic.subscribe(take);
  });
}
